"""Stage 1: which unknowns every factor touches, and their places in the information matrix.

Variables are numbered: the frames' poses, the markers, the antennas, w, and z where the ranges
calibrate themselves. Their unknowns lie in the order in which they are eliminated. All this depends
on the Measurements alone, so it is found once for all states, kernels and values of the noise.
"""

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse


@dataclass(frozen=True)
class Structure:
    """Rows of v variables with n unknowns, and places of their blocks in a matrix (n, n)."""

    width: np.ndarray        # (v,) number of unknowns of every variable
    rank: np.ndarray         # (v,) its place in the order of elimination
    begin: np.ndarray        # (v,) its first row
    block: np.ndarray        # (b,) every block: rank of its column times v, plus rank of its row
    place: np.ndarray        # (b,) of a block's first entry in the data of the matrix
    height: np.ndarray       # (v,) number of entries in every column of a variable
    indices: np.ndarray      # (e,) row of every entry, column by column
    indptr: np.ndarray       # (n + 1,) where each column begins

    def rows(self, variables, width):
        """Rows (m, width) of the unknowns of `variables` (m,)."""
        return self.begin[variables][:, None] + np.arange(width, dtype=np.int32)

    def rows_of_factors(self, variables):
        """Rows (m, c) of the unknowns of factors on `variables` (m, p), all of the same widths."""
        return np.concatenate([self.rows(own, width) for own, width in
                               zip(variables.T, self._widths(variables))], axis=1)

    def places(self, variables):
        """Places (m, c, c) of what factors as of `rows_of_factors` add to the matrix."""
        pairs = [(own, np.arange(width, dtype=np.int32)) for own, width in
                 zip(variables.T, self._widths(variables))]

        def of_block(row, column, offset, into):
            found = np.searchsorted(self.block, self.rank[column] * len(self.rank) + self.rank[row])
            return (self.place[found][:, None, None] + offset
                    + self.height[column][:, None, None] * into[:, None])

        return np.concatenate([np.concatenate([
            of_block(row, column, offset, into) for row, offset in pairs], axis=2)
            for column, into in pairs], axis=1)

    @cached_property
    def diagonal(self):
        """(n,) places of the diagonal."""
        column = np.repeat(np.arange(len(self.indptr) - 1), np.diff(self.indptr))
        return np.flatnonzero(column == self.indices)

    def _widths(self, variables):
        return self.width[variables[0]] if len(variables) else np.zeros(variables.shape[1], int)

    def matrix(self, data):
        """The sparse matrix (n, n) with data (e,)."""
        matrix = copy(self._pattern)                     # its indices are checked only once
        matrix.data = data
        return matrix

    @cached_property
    def _pattern(self):
        size = len(self.indptr) - 1
        return sparse.csc_array((np.zeros(len(self.indices)), self.indices, self.indptr),
                                shape=(size, size))


def structure(width, rank, factors):
    """The Structure of variables (v,) and of `factors`, a list of (m, p) variables of factors."""
    count = len(width)
    begin = np.empty(count, np.int32)             # half the memory of int: there are many places
    order = np.argsort(rank)
    begin[order] = np.cumsum(width[order]) - width[order]
    factors = [*factors, np.arange(count)[:, None]]
    block = np.unique(np.concatenate([
        rank[column] * count + rank[row] for variables in factors
        for column in variables.T for row in variables.T]))
    column, row = (order[part] for part in np.divmod(block, count))
    above = np.cumsum(width[row]) - width[row]                 # heights of all blocks before
    first = np.searchsorted(block, rank[np.arange(count)] * count)
    height = np.bincount(column, width[row], count).astype(np.int32)
    entries = height * width
    column_begin = np.empty(count, int)
    column_begin[order] = np.cumsum(entries[order]) - entries[order]
    place = (column_begin[column] + above - above[first[column]]).astype(np.int32)
    indices = np.empty(entries.sum(), np.int32)
    for c in range(width.max()):
        for r in range(width.max()):
            inside = (c < width[column]) & (r < width[row])
            indices[(place + c * height[column] + r)[inside]] = (begin[row] + r)[inside]
    indptr = np.zeros(width.sum() + 1, np.int32)
    indptr[1:] = np.cumsum(np.repeat(height[order], width[order]))
    return Structure(width=width, rank=rank, begin=begin, block=block, place=place, height=height,
                     indices=indices, indptr=indptr)
