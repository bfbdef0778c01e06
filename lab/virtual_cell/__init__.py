"""Parts of the cell in virtual time: processes, network, lines, devices, camera and people."""
