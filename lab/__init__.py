"""Laboratory of the cell: faults in virtual time, invariants and mutation tests; not installed."""
