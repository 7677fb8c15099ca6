"""The errors that users see: one line each, the cause first and then the mend.

All derive from :class:`SundaeError`, so that the command line can show them without a traceback. Each also derives from
the built-in exception that callers would catch anyway. Floor 0: imports nothing of the package.
"""


class SundaeError(Exception):
    """Base class of every error raised on purpose by ``sundae_ns``."""


class ConfigError(SundaeError, ValueError):
    """An option has a value that cannot work, or two options contradict each other."""


class DataError(SundaeError, ValueError):
    """Input data (images, cameras, point clouds, primitives) cannot be used."""


class BackendError(SundaeError, RuntimeError):
    """A rasteriser or device was asked for that is not available here."""


class CheckpointError(SundaeError, ValueError):
    """A checkpoint does not fit the model.

    A ``ValueError`` on purpose: ``nerfstudio`` retries non-strictly when loading raises a ``RuntimeError``.
    """
