"""The nodes of the two serial devices, ``scara_arm`` and ``tapper_trigger``."""
