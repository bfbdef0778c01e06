"""Steps for commissioning a cell, from no configuration to the first goal."""
