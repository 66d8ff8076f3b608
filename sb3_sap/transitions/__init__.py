"""Transitions from elsewhere: arrays, replay buffers, trajectories, data sets and tables."""
