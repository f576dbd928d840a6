"""Makes this process, and those that it starts, lack what Windows or macOS lack, for slamlib alone.

Python imports this module at its start where its folder is in PYTHONPATH. UNLIKE names the system,
as `sys.platform` does. With "win32" files in the folder UNLIKE_IN can neither be removed nor
replaced while this process has them open. Other packages find the system as it is: they have code
for each.
"""

import builtins
import os
import shutil
from importlib import import_module
from types import ModuleType

LACKING = {
    "win32": {"resource": None, "os": {"sched_getaffinity", "fork", "killpg"},
              "signal": {"SIGHUP", "SIGKILL"}, "socket": {"AF_UNIX"}}}[os.environ["UNLIKE"]]
imported = builtins.__import__


class Lacking(ModuleType):
    """A module without some of its attributes."""

    def __getattr__(self, name):
        if name in LACKING[self.__name__]:
            raise AttributeError(name)
        return getattr(import_module(self.__name__), name)


given = {name: Lacking(name) for name in LACKING} | {"sys": Lacking("sys")}
LACKING["sys"] = ()
given["sys"].platform = os.environ["UNLIKE"]


def import_there(name, globals=None, *arguments, **options):
    """What `import` does, with other modules for slamlib."""
    package = (globals or {}).get("__package__") or ""
    if package.partition(".")[0] != "slamlib":
        return imported(name, globals, *arguments, **options)
    if LACKING.get(name, ()) is None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return given.get(name) or imported(name, globals, *arguments, **options)


def unless_open(act):
    """The function of paths that refuses those of files that are open here."""
    def guarded(*paths, **options):
        for path in map(os.path.realpath, paths):
            if path.startswith(os.environ["UNLIKE_IN"]):
                for number in os.listdir("/proc/self/fd"):
                    try:
                        is_open = os.readlink(f"/proc/self/fd/{number}") == path
                    except FileNotFoundError:       # that of the list itself
                        continue
                    if is_open:
                        raise PermissionError(13, "is open in another program", path)
        return act(*paths, **options)
    return guarded


builtins.__import__ = import_there
if os.environ["UNLIKE"] == "win32":
    for each in ("unlink", "remove", "rename", "replace"):
        setattr(os, each, unless_open(getattr(os, each)))
    shutil._use_fd_functions = False
