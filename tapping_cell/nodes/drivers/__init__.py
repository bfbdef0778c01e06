"""The nodes ``scara_arm`` and ``tapper_trigger`` of the two serial devices."""
