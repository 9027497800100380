"""The covariance of biases: of all, or of those of each sensor by themselves where there is no room for that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probcal.lazy import xr
from probcal.results.schema import matrix_of

if TYPE_CHECKING:
    from probcal.model.rows import Linearised


class SensorBlocks(NamedTuple):
    """The covariance of M biases, as far as a fit knows it; those of two blocks count as independent."""

    biases: int  # M
    members: np.ndarray  # (B, p) biases of each block, M of none
    covariance: np.ndarray  # (B, p, p); 1 on the diagonal where a block has fewer

    @classmethod
    def of(cls, covariance: np.ndarray) -> SensorBlocks:
        """All biases in one block, by their covariance (M, M)."""
        return cls(len(covariance), np.arange(len(covariance))[None], covariance[None])

    @classmethod
    def drawn(cls, z: np.ndarray, members: np.ndarray, variance: np.ndarray) -> SensorBlocks:
        """Those of draws z (D, M); of a single draw, which has no spread, the variances (M,)."""
        M, none = len(variance), members == len(variance)
        away = np.pad(z - z.mean(0), ((0, 0), (0, 1)))
        eye, covariance = np.eye(members.shape[1])[None], np.zeros((*members.shape, members.shape[1]))
        for b, block in enumerate(members):
            covariance[b] = away[:, block].T @ away[:, block] / max(len(z) - 1, 1)
        if len(z) == 1:
            covariance = eye * np.append(variance, 0.0)[members][:, None]
        return cls(M, members, covariance + eye * none[:, None])

    @property
    def whole(self) -> bool:
        """True if the covariance of all biases is held."""
        return self.members.shape == (1, self.biases)

    @property
    def variance(self) -> np.ndarray:
        """Variance of each bias, (M,)."""
        return self.of_biases(np.diagonal(self.covariance, axis1=1, axis2=2))

    def contraction(self) -> dict[str, np.ndarray]:
        """A column with the share that data narrow each bias, of its declared scale; of blocks under these."""
        return {"contraction": np.clip(1.0 - self.variance, 0.0, 1.0)}

    def of_biases(self, values: np.ndarray) -> np.ndarray:
        """Values (B, p) of the members as (M,)."""
        found = np.zeros(self.biases + 1, values.dtype)
        found[self.members] = values
        return found[:-1]

    def located(self) -> tuple[np.ndarray, np.ndarray]:
        """Block (M,) of each bias, and its place (M,) there."""
        number = np.broadcast_to(np.arange(len(self.members))[:, None], self.members.shape)
        place = np.broadcast_to(np.arange(self.members.shape[1]), self.members.shape)
        return self.of_biases(number), self.of_biases(place)

    def columns(self, scales: np.ndarray) -> dict[str, Any]:
        """Variables of the group `calibration`: of each bias its block, and its covariance with the members of that."""
        if self.whole:
            return {"covariance": (("bias_label", "bias_label_other"), self.matrix() * np.outer(scales, scales))}
        own, (number, place) = np.append(scales, 0.0)[self.members], self.located()
        rows = self.covariance * own[:, :, None] * own[:, None, :]
        return {
            "block": ("bias_label", number), "block_place": ("bias_label", place),
            "block_covariance": (("bias_label", "place"), rows[number, place]),
        }  # fmt: skip

    @classmethod
    def read(
        cls, group: xr.Dataset, labels: Sequence[str], whose: str, scales: np.ndarray | None = None
    ) -> SensorBlocks:
        """Those of some biases as a group `calibration` has them; over the scales (M,) where these are given.

        Raises `InputError` where it has none.
        """
        scales = np.ones(len(labels)) if scales is None else scales
        if "block" not in group:
            held = matrix_of(group, "covariance", whose).sel(bias_label=list(labels), bias_label_other=list(labels))
            return cls.of(held.values / np.outer(scales, scales))
        own = group[["block", "block_place", "block_covariance"]].sel(bias_label=list(labels))
        number = np.unique(own["block"].values, return_inverse=True)[1]
        place, M, p = own["block_place"].values, len(labels), group.sizes["place"]
        members = np.full((number.max(initial=-1) + 1, p), M)
        members[number, place] = np.arange(M)
        covariance = np.zeros((*members.shape, p))
        covariance[number, place] = own["block_covariance"].values
        over, there = 1.0 / np.append(scales, 1.0)[members], members < M
        covariance *= over[:, :, None] * over[:, None, :] * (there[:, :, None] & there[:, None, :])
        return cls(M, members, covariance + np.eye(p)[None] * ~there[:, :, None])

    def predicted(self, read: Sequence[np.ndarray], rows: Sequence[Linearised]) -> list[np.ndarray]:
        """Variance of each predicted value (N, C) by the biases of its sensor, over that of its noise.

        `read` (N, p) are those that each row of a block reads.
        """
        own, place = (np.append(values, 0) for values in self.located())
        found = []
        for bias, lin in zip(read, rows, strict=True):
            block, at, along = own[bias], place[bias], np.asarray(lin.bias)
            there = bias < self.biases
            same = (block[:, :, None] == block[:, None, :]) & there[:, :, None] & there[:, None, :]
            covariance = self.covariance[block[:, :, None], at[:, :, None], at[:, None, :]]
            spread = np.einsum("ncp,npq,ncq->nc", along, np.where(same, covariance, 0.0), along)
            found.append(np.asarray(lin.weight) * spread)
        return found

    def widened(self, wide: np.ndarray) -> SensorBlocks:
        """With the sd of each bias times `wide` (M,)."""
        own = np.append(wide, 1.0)[self.members]
        return self._replace(covariance=self.covariance * own[:, :, None] * own[:, None, :])

    def matrix(self) -> np.ndarray:
        """The covariance (M, M)."""
        found = np.zeros((self.biases + 1, self.biases + 1))
        found[self.members[:, :, None], self.members[:, None, :]] = self.covariance
        return found[:-1, :-1]

    def under_scales(self) -> SensorBlocks:
        """The blocks under a prior of one scale per bias, from those under a flat prior."""
        eye = np.eye(self.members.shape[1])[None]
        return self._replace(covariance=np.linalg.inv(np.linalg.inv(self.covariance) + eye))

    def root(self) -> Any:
        """A root (M, R) of the covariance, sparse where sensors are independent."""
        if self.whole:
            from probcal import linalg  # loads JAX

            return linalg.symmetric_root(self.matrix())
        from scipy.sparse import csc_array  # loaded where it is used

        B, p = self.members.shape
        row = np.broadcast_to(self.members[:, :, None], (B, p, p))
        column = np.broadcast_to((p * np.arange(B)[:, None] + np.arange(p))[:, None, :], (B, p, p))
        there = row < self.biases
        values, vectors = np.linalg.eigh(np.where(there & there.mT, self.covariance, 0.0))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]  # of rank 0 too, as of chains that stand still
        return csc_array((root[there], (row[there], column[there])), (self.biases, B * p))
