"""Stage 1: the sparsity structure of the information matrix H.

Variables are numbered: the frames' poses, the markers and the antennas. Their unknowns are in the
order in which they are eliminated. The structure depends on the Measurements alone and is computed
once for all states, kernels and values of the noise.
"""

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse


@dataclass(frozen=True)
class Variables:
    """Numbers of the variables."""

    frames: np.ndarray       # (f,) of X_i
    markers: np.ndarray      # (k,) of L_j or P_j
    antennas: np.ndarray     # (a,) of A_k


@dataclass(frozen=True)
class Structure:
    """Rows of v variables with n unknowns, and places of their blocks in a matrix (n, n).

    A place is an index in the data of the matrix, which is stored column by column.
    """

    width: np.ndarray        # (v,) number of unknowns of every variable
    elimination_order: np.ndarray    # (v,) position of every variable in the elimination
    first_row: np.ndarray    # (v,) row of the first unknown of every variable
    block: np.ndarray        # (b,) sorted keys: order of the column times v, plus order of the row
    first_place: np.ndarray  # (b,) place of every block's first entry
    column_height: np.ndarray        # (v,) number of entries in every column of a variable
    indices: np.ndarray      # (e,) row of every entry, column by column
    indptr: np.ndarray       # (n + 1,) where each column begins

    def rows(self, variables, width):
        """Rows (m, width) of the unknowns of `variables` (m,)."""
        return self.first_row[variables][:, None] + np.arange(width, dtype=np.int32)

    def rows_of_each(self, variables):
        """List of the rows (d,) of each of `variables` (m,), which may have different widths."""
        return [self.rows([number], self.width[number])[0] for number in variables]

    def rows_of_factors(self, variables):
        """Rows (m, p) of the unknowns of factors on `variables` (m, q), all of the same widths."""
        return np.concatenate([self.rows(numbers, width) for numbers, width in
                               zip(variables.T, self._widths(variables))], axis=1)

    def places(self, variables):
        """Places (m, p, p) of the information J^T J of such factors."""
        blocks = [(numbers, np.arange(width, dtype=np.int32)) for numbers, width in
                  zip(variables.T, self._widths(variables))]

        def places_of_block(row, column, rows, columns):
            order = self.elimination_order
            block = np.searchsorted(self.block, order[column] * len(order) + order[row])
            return (self.first_place[block][:, None, None] + rows
                    + self.column_height[column][:, None, None] * columns[:, None])

        return np.concatenate([np.concatenate([
            places_of_block(row, column, rows, columns) for row, rows in blocks], axis=2)
            for column, columns in blocks], axis=1)

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


def block_structure(width, elimination_order, factor_variables):
    """The Structure of variables with these widths and positions in the elimination, (v,) each.

    `factor_variables` lists, for each kind of factor, the variables (m, q) of its m factors.
    """
    count = len(width)
    first_row = np.empty(count, np.int32)         # half the memory of int: there are many places
    order = np.argsort(elimination_order)
    first_row[order] = np.cumsum(width[order]) - width[order]
    block = np.unique(np.concatenate([
        elimination_order[column] * count + elimination_order[row]
        for variables in (*factor_variables, np.arange(count)[:, None])
        for column in variables.T for row in variables.T]))
    column, row = (order[part] for part in np.divmod(block, count))
    above = np.cumsum(width[row]) - width[row]                 # heights of all blocks before
    first = np.searchsorted(block, elimination_order * count)
    column_height = np.bincount(column, width[row], count).astype(np.int32)
    entries = column_height * width
    column_start = np.empty(count, int)
    column_start[order] = np.cumsum(entries[order]) - entries[order]
    first_place = (column_start[column] + above - above[first[column]]).astype(np.int32)
    indices = np.empty(entries.sum(), np.int32)
    for c in range(width.max()):
        for r in range(width.max()):
            inside = (c < width[column]) & (r < width[row])
            places = first_place + c * column_height[column] + r
            indices[places[inside]] = (first_row[row] + r)[inside]
    indptr = np.zeros(width.sum() + 1, np.int32)
    indptr[1:] = np.cumsum(np.repeat(column_height[order], width[order]))
    return Structure(
        width=width, elimination_order=elimination_order, first_row=first_row, block=block,
        first_place=first_place, column_height=column_height, indices=indices, indptr=indptr)
