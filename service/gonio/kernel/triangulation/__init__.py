"""From image points to lab points: linear start, robust refinement, covariance, association of people."""
