"""Local features: extractors, matchers, and the weights of the learned ones."""
