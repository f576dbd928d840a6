"""Restores notebooks to the form in which they are committed, to the byte.

    python strip_notebooks.py FILE...     restores these files
    python strip_notebooks.py < FILE      prints what is restored; so git's filter does

Outputs go, and what editors write into the metadata; in JupyterLab the code of cells with the tag
hide-input is collapsed. It needs no package, so that git is fast.
"""

import json
import os
import sys

# Keys of the metadata of cells and notebooks that the report reads, and the other metadata.
CELL_KEYS = ("tags", "alt", "slamlib")
NOTEBOOK_KEYS = ("slamlib",)
KERNEL = {
    "kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"},
    "language_info": {"name": "python"}}


def restored(content: bytes) -> bytes:
    """Return a notebook in its committed form; ValueError if it is not a notebook."""
    try:
        book = json.loads(content)
        book["metadata"] = KERNEL | _only(NOTEBOOK_KEYS, book["metadata"])
        for cell in book["cells"]:
            metadata = _only(CELL_KEYS, cell["metadata"])
            if "hide-input" in metadata.get("tags", ()):
                metadata["jupyter"] = {"source_hidden": True}
            cell["metadata"] = metadata
            cell["source"] = "".join(cell["source"]).splitlines(keepends=True)
            if cell["cell_type"] == "code":
                cell["execution_count"] = None
                cell["outputs"] = []
            elif not cell.get("attachments"):
                cell.pop("attachments", None)
    except (KeyError, TypeError, AttributeError):
        raise ValueError("expected a notebook with cells and metadata") from None
    text = json.dumps(book, indent=1, sort_keys=True, ensure_ascii=False)
    return f"{text}\n".encode()


def _only(keys, metadata):
    return {key: metadata[key] for key in keys if metadata.get(key)}


def main(names: list[str]) -> int | str:
    """Restore the files with these names, or standard input; return 0, or a sentence on failure."""
    try:
        for name in names:
            with open(name, "rb") as file:
                content = file.read()
            new = restored(content)
            if new != content:
                with open(f"{name}.new", "wb") as file:
                    file.write(new)
                os.replace(f"{name}.new", name)
        if not names:
            name = "standard input"
            sys.stdout.buffer.write(restored(sys.stdin.buffer.read()))
    except ValueError as error:
        return f"{name} is not a notebook: {error}"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
