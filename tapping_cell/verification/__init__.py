"""The cell's own logic, drivers and boards in virtual time, under every fault, from one seed."""
