"""Fails with one sentence where gtsam cannot run. Any Python can run this file."""

import platform
import sys

GTSAM = ["4", "3"]                      # of its version; pyproject.toml pins the wheel's


def problem():
    """A sentence that says why gtsam cannot run here, or None."""
    reason = without_wheel()
    if reason and sys.version_info >= (3, 11) and installed() == GTSAM:
        return None                     # from conda, say
    return reason


def without_wheel():
    """A sentence that says why there is no wheel of gtsam for this Python, or None."""
    system = platform.system()
    machine = platform.machine().lower()
    if system == "Windows":
        return ("gtsam has no wheel for Windows: run this inside WSL2, or in conda's environment "
                "of environment.yml, which was not tried on Windows (see environment.md).")
    if (system, machine) not in (("Linux", "x86_64"), ("Linux", "aarch64"),
                                 ("Darwin", "x86_64"), ("Darwin", "arm64")):
        return "gtsam has no wheel for %s on %s (see environment.md)." % (system, machine)
    if system == "Linux" and platform.libc_ver()[0] != "glibc":
        return ("gtsam's Linux wheel needs glibc, which this Python does not use "
                "(see environment.md).")
    version = tuple(sys.version_info[:2])
    implementation = platform.python_implementation()
    if implementation != "CPython" or not (3, 11) <= version <= (3, 14):
        return ("Python 3.11 to 3.14 (CPython) is needed, and %s is %s %d.%d: install one and say "
                "`make PYTHON=python3.12 ...` (see environment.md)."
                % (sys.executable, implementation, version[0], version[1]))
    return None


def installed():
    """The first two numbers of gtsam's version, or None where it cannot be imported."""
    try:
        from importlib.metadata import version

        import gtsam  # noqa: F401
        return version("gtsam").split(".")[:2]
    except Exception:                   # a library for another system raises many kinds
        return None


if __name__ == "__main__":
    sys.exit(problem())
