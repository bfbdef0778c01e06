"""Fault injection: runs the cell's logic, drivers and boards in virtual time, from one seed."""
