"""Measurements of size and speed: commands, not tests; each beside the obvious alternative, in the same run."""
