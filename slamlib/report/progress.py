"""How far the notebooks are: a bar on a terminal, elsewhere a line at times.

The time left comes from the seconds that each code cell took when it was executed last. They are
kept in a JSON file, by the notebook's name and a digest of the cell's source.
"""

import json
import re
import sys
import time

from tqdm import tqdm

from slamlib import swap
from slamlib.studies.memory import digest

EVERY = 15.0  # s, between lines where there is no terminal
BAR = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
HEADING = re.compile(r"^#+\s+(.+)", re.MULTILINE)


class Progress:
    """The code cells of notebooks, of which a limited number is executed at a time.

    Parameters
    ----------
    books : dict from Path to NotebookNode.
    jobs : int, notebooks executed at a time.
    told : Path, a folder in which studies say how far they are, in a file named as the notebook.
    file : Path of the seconds that cells took, or None.
    other : Path of what they took where studies were kept otherwise, or None. It is asked for
        notebooks of which `file` knows nothing.
    bound : "at most" or "at least", what the seconds of `other` are.
    """

    def __init__(self, books, jobs, told, file=None, other=None, bound="at most"):
        self.cells = {source.stem: _cells(book) for source, book in books.items()}
        self.seconds = {name: [] for name in self.cells}  # of the cells that are done
        self.began = {}  # by notebook: when its present cell began
        self.jobs, self.told, self.file, self.known = jobs, told, file, _read(file)
        self.others, self.bound = _read(other), bound
        self.next_line = time.monotonic() + EVERY
        self.bar = tqdm(total=sum(map(len, self.cells.values())), leave=False, bar_format=BAR,
                        disable=not sys.stderr.isatty())

    def begin(self, name):
        """Begin the next cell of a notebook (str, the stem of its file)."""
        self.began[name] = time.monotonic()

    def end(self, name):
        """End the present cell of a notebook."""
        self.seconds[name].append(time.monotonic() - self.began.pop(name))
        self.bar.update()

    def keep(self, name):
        """Write what the cells of a notebook took, in the place of what they took before."""
        if self.file is not None:
            keys = (key for key, _ in self.cells[name])
            self.known[name] = dict(zip(keys, self.seconds[name]))
            swap.write_atomically(self.file, json.dumps(self.known, indent=1).encode())

    def show(self):
        """Bring the bar up to date; without one print a line if the last is EVERY seconds old."""
        at = [self._position(name) for name in self.cells if name in self.began]
        left = self._left()
        if not self.bar.disable:
            self.bar.set_description_str(at[0] if at else "")
            self.bar.set_postfix_str(left)
        elif time.monotonic() >= self.next_line:
            self.next_line = time.monotonic() + EVERY
            count = f"{sum(map(len, self.seconds.values()))} of {self.bar.total} cells"
            print("; ".join([f"{count}, {left}" if left else count, *at]), file=sys.stderr)

    def _position(self, name):
        number = len(self.seconds[name])
        section = self.cells[name][number][1]
        try:
            study = (self.told / name).read_text()
        except FileNotFoundError:  # none runs
            study = ""
        return ", ".join(filter(None, [
            f"{name}: cell {number + 1} of {len(self.cells[name])}", section, study]))

    def _left(self):
        """Return the time until the last notebook ends (str), "" if no cell is known."""
        each, complete, word = [], True, "about"
        for name, cells in self.cells.items():
            known = self.known.get(name)
            if known is None:
                known = self.others.get(name, {})
                word = self.bound if len(self.seconds[name]) < len(cells) else word
            ahead = [known.get(key) for key, _ in cells[len(self.seconds[name]):]]
            complete &= None not in ahead
            ahead = [seconds or 0.0 for seconds in ahead]
            if name in self.began:
                ahead[0] = max(0.0, ahead[0] - (time.monotonic() - self.began[name]))
            each.append(sum(ahead))
        seconds = max(*each, sum(each) / self.jobs)
        if not seconds:
            return ""
        text = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"{word if complete else 'at least'} {text} left"


def _cells(book):
    """Return digest and section (str, may be "") of each code cell that is not empty."""
    cells, section = [], ""
    for cell in book.cells:
        if cell.cell_type == "markdown":
            section = (HEADING.findall(cell.source) or [section])[-1]
        elif cell.cell_type == "code" and cell.source.strip():
            cells.append((digest(cell.source.encode()), section))
    return cells


def _read(file):
    """Return {notebook: {digest of the cell: seconds}} from a file, {} if there is none in it."""
    try:
        known = json.loads(file.read_bytes()) if file else {}
        return {name: {key: float(seconds) for key, seconds in cells.items()}
                for name, cells in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
