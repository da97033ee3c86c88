from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nnit_zoo import diversity
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch

ARCHITECTURE = Architecture(6, (16, 4, 32), 3)


def random_batch(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> PolicyBatch:
    draw = torch.Generator().manual_seed(seed)
    layers = (torch.randn(count, *shape, generator=draw) / 3 for shape in ARCHITECTURE.block_shapes)
    return PolicyBatch(ARCHITECTURE, tuple(layer.to(dtype) for layer in layers))


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 6), st.integers(0, 99), st.sampled_from([torch.float16, torch.float64]))
def test_pairwise_measures_are_those_of_each_pair(count: int, seed: int, dtype: torch.dtype) -> None:
    batch = random_batch(count, seed, dtype)
    flat = batch.flat().double().numpy()
    l2, cosine = diversity.distances(batch).numpy(), diversity.cosines(batch).numpy()
    for i in range(count):
        for j in range(count):
            np.testing.assert_allclose(l2[i, j], np.linalg.norm(flat[i] - flat[j]), rtol=1e-12, atol=1e-14)
            expected = flat[i] @ flat[j] / np.linalg.norm(flat[i]) / np.linalg.norm(flat[j])
            np.testing.assert_allclose(cosine[i, j], expected, rtol=1e-10, atol=1e-12)
    assert len(diversity.pairs(diversity.distances(batch))) == count * (count - 1) / 2


def test_a_near_copy_keeps_its_distance() -> None:
    batch = random_batch(2)
    batch = PolicyBatch(ARCHITECTURE, tuple(layer[:1].repeat(2, 1, 1) for layer in batch.layers))
    batch.layers[0][1, 0, 0] += 1e-9
    assert diversity.distances(batch)[0, 1] == pytest.approx(1e-9, rel=1e-5)  # by the Gram matrix it would be 0


def test_one_policy_has_no_neighbour() -> None:
    with pytest.raises(UserError, match="at least two"):
        diversity.off_diagonal(diversity.distances(random_batch(1)))
    matrix = torch.arange(9).view(3, 3)
    assert diversity.off_diagonal(matrix).tolist() == [[1, 2], [3, 5], [6, 7]]


def test_correlation_is_pearsons_over_all_pairs() -> None:
    rows = torch.randn(5, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix = np.corrcoef(rows.numpy())
    assert diversity.mean_correlation(rows) == pytest.approx(matrix[np.triu_indices(5, 1)].mean(), abs=1e-12)
    assert diversity.mean_correlation(torch.stack([rows[0], -2 * rows[0] + 1])) == pytest.approx(-1)


def test_magnitudes_are_means_over_what_leaves_an_input_neuron() -> None:
    batch = random_batch(2)
    for layer, magnitude in zip(batch.layers, diversity.magnitudes(batch), strict=True):
        assert magnitude.shape == (2, layer.shape[2] - 1)
        assert magnitude[1, 0] == pytest.approx(float(layer[1, :, 0].abs().mean()))


def test_cka_is_kornblith_and_blind_to_rotations() -> None:
    batch = random_batch(3)
    observations = torch.randn(50, 6, generator=torch.Generator().manual_seed(1))
    found = diversity.cka(batch, observations)
    assert found.shape == (3, 3)

    def centred_gram(policy: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        first = batch.to_module(policy)[:2].double()
        features = first(observations.double()).detach().numpy()
        middle = np.eye(50) - 1 / 50
        return middle @ features @ features.T @ middle

    grams = [centred_gram(policy) for policy in range(3)]
    hsic = [[np.trace(one @ other) for other in grams] for one in grams]
    expected = [hsic[i][j] / math.sqrt(hsic[i][i] * hsic[j][j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(found[0].numpy(), expected, rtol=1e-5)

    shuffled = [layer[:1].repeat(2, 1, 1) for layer in batch.layers]
    order = torch.randperm(16, generator=torch.Generator().manual_seed(2))
    shuffled[0][1] = shuffled[0][1][order]
    shuffled[1][1] = shuffled[1][1][:, torch.cat([order, torch.tensor([16])])]
    same = diversity.cka(PolicyBatch(ARCHITECTURE, tuple(shuffled)), observations)
    np.testing.assert_allclose(same.numpy(), 1, rtol=1e-9)
