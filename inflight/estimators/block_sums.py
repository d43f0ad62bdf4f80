"""Sums over blocks of what functions of time make of their equations, without a matrix for each of them.

Of seventy parameters a few depend on time: only their rows have to be looked at block by block, all others
are in the plain sum. Three thousand days so take milliseconds, and no memory of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

Owners = npt.NDArray[np.int64]


@dataclass(frozen=True)
class BlockSums:
    """Gram matrices of blocks and how much each block says.

    Attributes
    ----------
    gram : ndarray, shape (block, column + 1, column + 1)
        The residual last.
    weight : ndarray, shape (block,)
    """

    gram: Floats
    weight: Floats

    @cached_property
    def plain(self) -> Floats:
        """The weighted sum of the matrices; (column + 1, column + 1)."""
        return np.asarray(np.tensordot(self.weight, self.gram, 1))

    def expanded(self, values: Floats, owners: Owners) -> Floats:
        """Return the sum for columns that are functions of time.

        Parameters
        ----------
        values : ndarray, shape (block, function)
            What the owner's column is multiplied with.
        owners : ndarray of int, shape (function,)
            Column of the matrices each function belongs to.

        Returns
        -------
        ndarray, shape (function + 1, function + 1)
            The residual last.
        """
        every = np.append(owners, self.plain.shape[0] - 1)
        still = np.append(values[0], 1.0)
        out = self.plain[np.ix_(every, every)] * np.outer(still, still)
        moving = np.flatnonzero(np.ptp(values, axis=0) > 0)
        heavy = self.weight[:, None] * values
        for owner in np.unique(owners[moving]):
            mine = moving[owners[moving] == owner]
            row = heavy[:, mine].T @ self.gram[:, owner, :]
            out[mine, :] = row[:, every] * still
            out[:, mine] = out[mine, :].T
        for one in np.unique(owners[moving]):
            for other in np.unique(owners[moving]):
                mine, theirs = (moving[owners[moving] == owner] for owner in (one, other))
                own = self.gram[:, one, other, None] * values[:, theirs]
                out[np.ix_(mine, theirs)] = heavy[:, mine].T @ own
        return np.asarray(out)

    def scores(self, values: Floats, owners: Owners, parameters: Floats) -> Floats:
        """Return each block's scores at parameters of its own; (block, function).

        Parameters
        ----------
        values, owners
            As in `expanded`.
        parameters : ndarray, shape (block, column)
            Scaled changes from the reference.
        """
        turned = np.concatenate([parameters, np.ones((len(parameters), 1))], axis=1)
        slopes = np.matmul(self.gram, turned[:, :, None])[:, :, 0]
        return np.asarray(self.weight[:, None] * slopes[:, owners] * values)
