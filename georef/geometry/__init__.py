"""Rigid transforms, covariances, cameras, pixels and angles: numpy and scipy only, no files."""
