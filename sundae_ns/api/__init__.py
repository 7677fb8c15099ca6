"""The front door: what ``import sundae_ns`` offers, without nerfstudio.

:mod:`sundae_ns` exports the functions and types of these modules. Everything else of the package is behind them, and
the command line goes through them.
"""
