"""Bundle adjustment in GTSAM: the problem, its solution, gates, posterior covariances and variance components."""
