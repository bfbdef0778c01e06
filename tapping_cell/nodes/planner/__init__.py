"""The planning node ``tap_planner``: receives goals and publishes one tap command after another."""
