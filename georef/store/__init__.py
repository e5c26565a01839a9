"""What is kept between stages: one complete file an item, replaced as a whole."""
