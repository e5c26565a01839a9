"""A procedural street in two epochs with exact truth: the embedded demo and the world of the tests."""
