"""What the predictor is used for: Algorithm 1, constraints, the action filter and the auxiliary loss."""
