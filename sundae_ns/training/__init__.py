"""What trains a field: state, extensions, schedules, losses, optimizers, one step. Floor 5."""
