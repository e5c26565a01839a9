"""Frozen dataclasses that travel between the rooms; shapes stand in the annotations' comments."""
