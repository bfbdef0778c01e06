"""Steps for commissioning a cell, from an empty configuration to the first goal."""
