import numpy as np
import pytest
from numpy.typing import NDArray

from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Regular, Scalar
from kitting_drake.policies.networks.layers.planar_escnn import enn, gspaces

BAND_3 = Irreps((0, 1, 2, 3), samples=8)
FIBRES = [
    Scalar(),
    Irreps((0, 1, 2, 3)),
    BAND_3,
    Irreps((0, 1, 2, 3), samples=16),
    Irreps((0, 2, 4), samples=9),
    Regular(6),
    Regular(36, quotient=2),
]


def fourier_elu(frequencies: tuple[int, ...], samples: int) -> enn.FourierELU:
    space = gspaces.rot2dOnR2(-1, maximum_frequency=max(frequencies))
    irreps = [(j,) for j in frequencies]
    return enn.FourierELU(space, 1, irreps, type="regular", N=samples)


@pytest.mark.parametrize(
    ("frequencies", "samples"), [((0, 1, 2, 3), 8), ((0, 1, 2, 3), 16), ((0, 2, 4), 12)]
)
def test_samples_equal_those_of_escnn(frequencies: tuple[int, ...], samples: int):
    elu = fourier_elu(frequencies, samples)
    fibre = Irreps(frequencies, samples)
    np.testing.assert_allclose(fibre.synthesis(), elu.A.numpy(), atol=1e-6)
    np.testing.assert_allclose(fibre.analysis(), elu.Ainv.numpy(), atol=1e-6)


@pytest.mark.parametrize("fibre", FIBRES, ids=str)
def test_analysis_undoes_synthesis(fibre: Fibre):
    assert fibre.synthesis().shape == (fibre.channels, fibre.size)
    np.testing.assert_allclose(fibre.analysis() @ fibre.synthesis(), np.eye(fibre.size), atol=1e-12)


def rotation(fibre: Fibre, steps: int) -> NDArray[np.float64]:
    """The matrix (channels, channels) of a rotation by `steps` times the angle between samples."""
    return np.roll(np.eye(fibre.channels), steps, axis=0)


@pytest.mark.parametrize("fibre", [fibre for fibre in FIBRES if fibre.channels > 7], ids=str)
def test_the_invariant_does_not_depend_on_rotation(fibre: Fibre):
    functional = fibre.invariant()
    np.testing.assert_allclose(functional @ rotation(fibre, 1), functional)
    # The invariant is the first coefficient, as in escnn's Fourier ELU.
    first = functional @ fibre.synthesis()
    if isinstance(fibre, Irreps):
        np.testing.assert_allclose(first, np.eye(fibre.size)[0], atol=1e-12)


def test_invariant_needs_samples():
    with pytest.raises(ValueError, match="needs samples"):
        Irreps((0, 1)).invariant()


@pytest.mark.parametrize(
    ("frequencies", "samples", "message"),
    [
        ((0, 1, 2, 3), 6, "6 samples cannot hold frequency 3: at least 7 are needed"),
        ((0, 2, 1), 0, "ascending"),
        ((0, 1, 1), 0, "ascending"),
        ((-1, 0), 0, "ascending"),
    ],
)
def test_rejects_invalid_irreps(frequencies: tuple[int, ...], samples: int, message: str):
    with pytest.raises(ValueError, match=message):
        Irreps(frequencies, samples)


@pytest.mark.parametrize(("order", "quotient"), [(9, 2), (0, 1), (4, 0)])
def test_rejects_a_nonexistent_subgroup(order: int, quotient: int):
    with pytest.raises(ValueError, match="has no subgroup"):
        Regular(order, quotient)
