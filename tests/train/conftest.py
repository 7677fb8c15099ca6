"""Models on the CPU, of fields made in memory."""

from models import *  # noqa: F403
