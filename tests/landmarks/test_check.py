"""The check of a landmark of one's own: ours pass, and each thing that is wrong is named."""

import jax
import jax.numpy as jnp
import pytest
from cases import each_landmark, named

import jaxslam
from jaxslam.landmarks import InverseScaling, UnifiedInverseDepth

IS = InverseScaling()

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize("landmark", each_landmark, ids=named)
def test_every_parametrization_passes(landmark):
    jaxslam.check_landmark(landmark)


def with_functions(**functions):
    """Inverse Scaling with other functions."""
    methods = {name: staticmethod(function) for name, function in functions.items()}
    return type("Mine", (InverseScaling,), methods)()


def test_one_of_space_alone_passes_there():
    in_space = with_functions(size=lambda n: {3: 4}[n])
    jaxslam.check_landmark(in_space, jaxslam.SPATIAL)
    with pytest.raises(ValueError, match=r"inverse_scaling, planar: size fails: KeyError: 2$"):
        jaxslam.check_landmark(in_space)


def kinked(parameters):
    """A value that is right, and a derivative that is not: of the root of zero."""
    return parameters[:-1], parameters[-1] + jnp.sqrt(parameters[-1] - parameters[-1])


def in_front(parameters):
    """Points behind the camera have no value."""
    z = parameters[-2]
    return parameters[:-1], parameters[-1] * jnp.where(z > 0, 1.0, jnp.nan)


def moved_in_front(T, parameters):
    moved = IS.transform(T, parameters)
    return moved * jnp.where(moved[-2] > 0, 1.0, jnp.nan)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"size": lambda n: n}, r"initialise is of shape \(3,\); \(2,\) is accepted"),
        ({"size": lambda n: n + 1.0}, r"size\(2\) is 3\.0; a whole number"),
        (
            {"initialise": lambda X, omega, f: f * jnp.append(X, 1 / omega)},
            r"initialise: its point at 1/z = 0\.02 is \[.*\], and should be \[15\.5 50\. \]",
        ),
        (
            {"initialise": lambda X, omega, f: jnp.append(X, omega) if omega > 0 else X},
            r"initialise fails: TracerBoolConversionError",
        ),
        (
            {"transform": lambda T, p: IS.transform(T.inverse(), p)},
            r"transform: the moved point at",
        ),
        ({"transform": lambda T, p: 2 * IS.transform(T, p)}, r"transform by T and T⁻¹: the param"),
        ({"homogeneous": lambda p: (p[:-1], p[-1:])}, r"homogeneous is of shape"),
        ({"scale": lambda s, p: p.at[-1].multiply(s)}, r"scale: the enlarged point"),
        ({"convert": lambda C, p, P: 2 * p.at[0].add(1.0)}, r"convert: the point at"),
        (
            {"transform": lambda T, p: IS.transform(jax.lax.stop_gradient(T), p)},
            r"the derivative of transform by the pose at 1/z = 0\.02 is \[0\.",
        ),
        ({"homogeneous": kinked}, r"the derivative of \S+.* is not finite"),
        ({"homogeneous": in_front}, r"transform: the point moved behind the camera at"),
        ({"transform": moved_in_front}, r"transform: the point moved behind the camera at"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(wrong, told):
    with pytest.raises(ValueError, match=rf"^inverse_scaling, planar: {told}") as error:
        jaxslam.check_landmark(with_functions(**wrong), jaxslam.PLANAR)
    assert "\n" not in str(error.value)


class Staying(UnifiedInverseDepth):
    """Its anchor stays where it is when all lengths are enlarged."""

    def scale(self, factor, landmark):
        return landmark.at[-1].divide(factor)


def test_the_anchor_belongs_to_the_point():
    with pytest.raises(ValueError, match="scale: the enlarged point"):
        jaxslam.check_landmark(Staying(), jaxslam.PLANAR)


def test_what_is_no_parametrization_is_refused():
    with pytest.raises(ValueError, match=r"a jaxslam\.AbstractLandmark is accepted, not str"):
        jaxslam.check_landmark("inverse_scaling")  # ty: ignore[invalid-argument-type]
