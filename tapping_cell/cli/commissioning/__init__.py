"""The steps of commissioning a cell, from nothing configured to the first goal."""
