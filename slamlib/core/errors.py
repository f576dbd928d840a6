"""The error that is told in one sentence."""


class DatasetError(ValueError):
    """A dataset does not follow the format; one sentence names file, line and expectation."""


def require(ok, source, expected, found=None):
    """Raise DatasetError about a source, a file with its line or an argument, unless it is `ok`."""
    if not ok:
        told = "" if found is None else f", found {quoted(found)}"
        raise DatasetError(f"{source}: expected {expected}{told}")


def quoted(value):
    """The first 60 characters (str) of a value, in quotes."""
    text = str(value)
    return repr(text if len(text) <= 60 else text[:60] + "...")
