"""The YAML files of a cell as frozen dataclasses, checked strictly against units and ranges."""
