"""What Windows needs, as far as Linux can tell: no module needs what only POSIX has."""

from __future__ import annotations

import subprocess
import sys

POSIX_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
IMPORTER = """
import importlib, os, pkgutil, signal, sys, sundae_ns

def load():
    for info in pkgutil.walk_packages(sundae_ns.__path__, "sundae_ns."):
        importlib.import_module(info.name)

load()  # libraries of others import what they need of this system
for name in [name for name in sys.modules if name.startswith("sundae_ns.")]:
    del sys.modules[name]
for name in sys.argv[1].split():
    sys.modules[name] = None
for name in ("killpg", "getpgid", "setsid", "fork", "getuid", "geteuid", "sched_getaffinity", "statvfs", "sysconf"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "SIGUSR1", "SIGXFSZ", "alarm", "pause", "setitimer"):
    delattr(signal, name)
for name in [name for name in vars(os) if name in ("O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_SYNC")]:
    delattr(os, name)
sys.platform = "win32"
load()
print(sum(name.startswith("sundae_ns.") for name in sys.modules))
"""


def test_every_module_is_imported_without_what_only_posix_has() -> None:
    words = [sys.executable, "-c", IMPORTER, " ".join(POSIX_MODULES)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) > 100
