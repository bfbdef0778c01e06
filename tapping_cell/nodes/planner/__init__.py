"""The planning node ``tap_planner``: goals in, one tap command after another out."""
