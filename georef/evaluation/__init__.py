"""Accuracy: poses against truth, check points against the adjusted block, and whether covariances are true."""
