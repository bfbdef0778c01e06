"""The laboratory: the cell in virtual time under faults, an oracle, and mutation of the logic.

It proves the product and is not part of it: nothing in ``tapping_cell`` imports it.
"""
