"""Chains that are stored by coordinate: the values are those of arrays and of emcee's own backend."""

import emcee
import numpy as np
import pytest

from bayesperiodic.sampling.chains import Points, StoredChains
from bayesperiodic.sampling.checkpoint import ColumnBackend
from bayesperiodic.sampling.proposals import AffineTransform


@pytest.mark.parametrize("blobs", [False, True])
def test_the_backend_by_coordinate_holds_what_emcee_holds(blobs):
    def log_prob(x):
        value = -0.5 * np.sum(x**2, axis=1)
        return np.column_stack([value, x[:, :2]]) if blobs else value

    results = []
    for backend in (emcee.backends.Backend(), ColumnBackend()):
        state = emcee.State(np.random.default_rng(1).standard_normal((8, 3)))
        state.random_state = np.random.RandomState(2).get_state()
        for steps in (30, 1, 25):
            sampler = emcee.EnsembleSampler(8, 3, log_prob, vectorize=True, backend=backend)
            state = sampler.run_mcmc(state, steps, skip_initial_state_check=True)
            if isinstance(backend, ColumnBackend):
                backend.forget(10)
                backend.forget(4)  # no longer there
        last = backend.get_last_sample()
        held = [backend.get_chain(discard=12), backend.get_log_prob(discard=12), last.coords, backend.accepted]
        results.append([*held, *([backend.get_blobs(discard=12), last.blobs] if blobs else [])])
        assert backend.iteration == 56 and backend.has_blobs() == blobs
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_coordinates_and_points_are_those_of_the_array():
    rng = np.random.default_rng(3)
    walked = rng.standard_normal((50, 2 * 4, 3))  # (steps, walkers of two ensembles, coordinates)
    transform = AffineTransform(rng.standard_normal(3), rng.standard_normal((3, 3)))
    whole = (walked @ transform.axes.T + transform.origin).reshape(50, 2, 4, 3).swapaxes(0, 1)
    chains = StoredChains([column.copy() for column in np.moveaxis(walked, -1, 0)], 2, transform)
    assert chains.shape == whole.shape
    np.testing.assert_allclose(chains[..., 1], whole[..., 1], atol=1e-12)
    np.testing.assert_array_equal(chains.points[slice(5, 9)], walked.reshape(-1, 3)[5:9])
    np.testing.assert_allclose(chains.unwhitened(slice(5, 9)), whole.swapaxes(0, 1).reshape(-1, 3)[5:9], atol=1e-12)
    chains.unwhiten()
    for k in range(3):
        np.testing.assert_allclose(chains[..., k], whole[..., k], atol=1e-12)
    np.testing.assert_array_equal(
        chains.thinned(100), np.stack([chains[..., k].reshape(2, -1)[:, ::4] for k in range(3)], -1)
    )
    np.testing.assert_array_equal(StoredChains.of(whole)[..., 2], whole[..., 2])
    np.testing.assert_array_equal(chains.with_columns([whole[..., 2]]).pop(0), whole[..., 2])
    assert len(Points([np.zeros(5)])) == 5
