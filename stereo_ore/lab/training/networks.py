"""Fitting of the small networks that judge points and pixels."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from stereo_ore.network import Network
from stereo_ore.types import F32, Mask


def fit_network(
    examples: F32, truth: Mask, hidden: int, epochs: int, seed: int, features: int | None = None
) -> Network:
    """Fit a network with `hidden` units to features (N, F) and truths (N,).

    Parameters
    ----------
    examples : (N, F) array
    truth : (N,) bool
    hidden, epochs : int
    seed : int
        Of the weights at the start and of the order of the examples.
    features : int or None
        Only the first ones may be used: the weights of the others are zero.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPClassifier
    from threadpoolctl import threadpool_limits

    mean, scale = examples.mean(0, dtype=np.float64), examples.std(0, dtype=np.float64) + 1e-9
    network = MLPClassifier(
        (hidden,), max_iter=epochs, batch_size=1000, learning_rate_init=4e-3, random_state=seed
    )
    known = ((examples - mean) / scale)[:, :features]
    # One thread, so that sums have the same last digits on any machine of a kind.
    with warnings.catch_warnings(), threadpool_limits(1):
        # A fixed number of epochs is meant.
        warnings.simplefilter("ignore", ConvergenceWarning)
        network.fit(known, truth)
    (inner, outer), (bias, offset) = network.coefs_, network.intercepts_
    rows = [_round(row) for row in inner] + [[0.0] * hidden] * (examples.shape[1] - known.shape[1])
    return Network(
        _round(mean), _round(scale), rows, _round(bias), _round(outer[:, 0]), _round(offset)[0]
    )


def _round(values: npt.NDArray[np.floating]) -> list[float]:
    """Five significant figures: readable, and more than the decision needs."""
    return [float(f"{value:.5g}") for value in values]
