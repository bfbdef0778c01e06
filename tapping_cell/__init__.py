"""A robot cell that positions flat objects on a table by tapping them."""

__version__ = "0.1.0"
