"""The packed scene."""
