"""One benchmark a room; see ``tapping_cell.cli.bench``."""
