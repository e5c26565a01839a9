"""Global descriptors: one vector an image, by which images of the same place are found."""
