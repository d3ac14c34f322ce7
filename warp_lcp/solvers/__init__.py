"""Methods, one a file; `registry.METHODS` has them by name."""
