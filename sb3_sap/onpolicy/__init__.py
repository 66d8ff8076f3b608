"""Permissibility for on-policy algorithms: masks of finite actions, candidates of continuous ones, labels, a loss."""
