"""Shows the progress of the notebooks: a bar on a terminal, elsewhere a line every 15 s.

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

LINE_INTERVAL = 15.0  # s, between lines where there is no terminal
# What the bar on a terminal shows, for tqdm.
BAR = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
SECTION = re.compile(r"^#+\s+(.+)", re.MULTILINE)  # a heading of any level in Markdown


class Progress:
    """The code cells of notebooks, of which a limited number is executed at a time.

    Parameters
    ----------
    books : dict from Path to NotebookNode.
    jobs : int, notebooks executed at a time.
    folder : Path, in which studies say how far they are, in a file named as the notebook.
    file : Path of the seconds that cells took.
    bounds_file : Path of what they took where studies were kept otherwise. It is asked for
        notebooks of which `file` knows nothing.
    bound : "at most" or "at least", what the seconds of `bounds_file` are.
    """

    def __init__(self, books, jobs, folder, file, bounds_file, bound):
        self.cells = {source.stem: _cells(book) for source, book in books.items()}
        self.seconds = {name: [] for name in self.cells}  # of the cells that are done
        self.began = {}  # by notebook: when its present cell began
        self.jobs, self.folder, self.file, self.bound = jobs, folder, file, bound
        self.known, self.bounds = _read(file), _read(bounds_file)
        self.next_line = time.monotonic() + LINE_INTERVAL
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
        """Replace the stored durations of the cells of a notebook."""
        keys = (key for key, _ in self.cells[name])
        self.known[name] = dict(zip(keys, self.seconds[name]))
        swap.write_atomically(self.file, json.dumps(self.known, indent=1).encode())

    def show(self):
        """Bring the bar up to date; without one print a line, if LINE_INTERVAL has passed."""
        positions = [self._position(name) for name in self.cells if name in self.began]
        left = self._left()
        if not self.bar.disable:
            self.bar.set_description_str(positions[0] if positions else "")
            self.bar.set_postfix_str(left)
        elif time.monotonic() >= self.next_line:
            self.next_line = time.monotonic() + LINE_INTERVAL
            count = f"{sum(map(len, self.seconds.values()))} of {self.bar.total} cells"
            print("; ".join([f"{count}, {left}" if left else count, *positions]), file=sys.stderr)

    def _position(self, name):
        number = len(self.seconds[name])
        section = self.cells[name][number][1]
        try:
            study = (self.folder / name).read_text()
        except FileNotFoundError:  # none runs
            study = ""
        return ", ".join(filter(None, [
            f"{name}: cell {number + 1} of {len(self.cells[name])}", section, study]))

    def _left(self):
        """Return the time until the last notebook ends (str), "" if no cell is known."""
        remaining, complete, word = [], True, "about"
        for name, cells in self.cells.items():
            done = len(self.seconds[name])
            if name not in self.known and done < len(cells):
                word = self.bound
            known = self.known.get(name, self.bounds.get(name, {}))
            ahead = [known.get(key) for key, _ in cells[done:]]
            complete &= None not in ahead
            ahead = [seconds or 0.0 for seconds in ahead]
            if name in self.began:
                ahead[0] = max(0.0, ahead[0] - (time.monotonic() - self.began[name]))
            remaining.append(sum(ahead))
        seconds = max(*remaining, sum(remaining) / self.jobs)
        if not seconds:
            return ""
        text = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"{word if complete else 'at least'} {text} left"


def _cells(book):
    """Return digest and section (str, may be "") of each code cell that is not empty."""
    cells, section = [], ""
    for cell in book.cells:
        if cell.cell_type == "markdown":
            section = (SECTION.findall(cell.source) or [section])[-1]
        elif cell.cell_type == "code" and cell.source.strip():
            cells.append((digest(cell.source.encode()), section))
    return cells


def _read(file):
    """Return {notebook: {digest of the cell: seconds}} from a file, {} if there is none in it."""
    try:
        return {name: {key: float(seconds) for key, seconds in cells.items()}
                for name, cells in json.loads(file.read_bytes()).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
