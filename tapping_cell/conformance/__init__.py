"""The duties of the cell's nodes, and checks that show whether a substitute for one fulfils them.

``docs/contracts.md`` lists the duties. A check plays all other nodes on a ``Stage``.
"""
