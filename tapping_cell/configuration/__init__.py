"""The YAML files of a cell as frozen dataclasses: strict, with units and ranges."""
