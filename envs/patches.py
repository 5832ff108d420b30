"""Worlds made on the device: every field of a compiled model as a function of the domain parameters.

MuJoCo compiles worlds on the host (`envs.mujoco.worlds`), which no jitted search can wait for. So a few hundred are
compiled at random parameters, once, and fields are fitted to them. A number of a model depends on few parameters. On
these it is a polynomial of low degree, or its logarithm, square or reciprocal is: a rotor's inertia is linear in its
mass, the inverse inertia that scales its contacts is reciprocal. Centres of mass are quotients, so their products with
the mass are fitted, and inertias about the body's origin.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from scipy.spatial.transform import Rotation as HostRotation

from envs.base import Env, Theta
from envs.effects import make_range
from envs.types import Array

_WORLDS, _HELD_OUT = 420, 60  # compiled for the fit, and those of them that choose between transforms
_BASES = 4  # random points around which each parameter is changed to see what depends on it
_DEGREE = 5
_TINY = 1e-30

# What is fitted in place of a number, and the way back, in NumPy or in jax.numpy.
_TRANSFORMS: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]] = {
    "itself": (lambda numpy, x: x, lambda numpy, y: y),
    "square": (lambda numpy, x: x * x, lambda numpy, y: numpy.sqrt(numpy.maximum(y, 0.0))),
    "reciprocal": (lambda numpy, x: 1.0 / x, lambda numpy, y: 1.0 / y),
    "logarithm": (lambda numpy, x: numpy.log(x), lambda numpy, y: numpy.exp(y)),
}


class Patches(NamedTuple):
    """How to make models of worlds without a compiler.

    model(params [n_params], raw units) -> `World.model`, but for MuJoCo's codes of shortcuts. Parameters lie in the
        ranges of the fit; what lies beyond is extrapolated.
    errors: by field, the largest difference from held-out compiled worlds, over its numbers, each in units of its std
        between worlds.
    """

    model: Callable[[Array], dict[str, Array]]
    errors: dict[str, float]


class _Group(NamedTuple):
    """Numbers that depend on the same parameters, fitted in the same way.

    columns: [c] their places in a flat model. inputs: [k] of the parameters that vary, those that matter. degree: of
    the polynomial. transform: see `_TRANSFORMS`. weights: [features, c]. middle, scale: [c] of what is fitted.
    """

    columns: np.ndarray
    inputs: np.ndarray
    degree: int
    transform: str
    weights: np.ndarray
    middle: np.ndarray
    scale: np.ndarray

    def __call__(self, point: Array) -> Array:
        """[c] the numbers at a point [parameters that vary] in [-1, 1]."""
        with jax.default_matmul_precision("highest"):
            fitted = _features(point[self.inputs], self.degree, jnp) @ jnp.asarray(self.weights, jnp.float32)
        back = _TRANSFORMS[self.transform][1]
        return back(jnp, jnp.asarray(self.middle, jnp.float32) + jnp.asarray(self.scale, jnp.float32) * fitted)


def patches(env: Env, ranges: np.ndarray) -> Patches:
    """Fits the models of a task's worlds to some that are compiled now, in seconds. Impure: MuJoCo compiles.

    ranges: [n_params, 2] low and high of every domain parameter; one whose ends are equal stays.
    """
    low, high = ranges.T
    which = np.flatnonzero(low < high)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (_WORLDS, len(which))).astype(np.float32)
    probes = _probes(rng, len(which))

    def compiled(units: np.ndarray) -> dict[str, np.ndarray]:
        params = np.tile(low, (len(units), 1))
        params[:, which] += 0.5 * (1.0 + units) * (high - low)[which]
        return _compiled(env, params)

    models = compiled(np.concatenate([points, *probes]))
    if not models or not which.size:
        only = {name: jnp.asarray(x[0], jnp.float32) for name, x in models.items()}
        return Patches(lambda params: only, {})
    exact = {name: x[:_WORLDS] for name, x in models.items()}
    sums = _sums(models)
    shapes = {name: x.shape[1:] for name, x in sums.items()}
    flat = np.concatenate([x.reshape(len(x), -1) for x in sums.values()], axis=1)
    depends = _depends(flat[_WORLDS:].reshape(*probes.shape[:2], -1))
    groups = list(_fitted(points, flat[:_WORLDS], depends))
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    varies = {
        name: x.reshape(shape).any(tuple(range(1, len(shape))), keepdims=True)
        for (name, shape), x in zip(shapes.items(), np.split(depends.any(0), ends), strict=True)
    }
    first = {name: jnp.asarray(x[0], jnp.float32) for name, x in exact.items()}

    def at(point: Array) -> dict[str, Array]:
        numbers = jnp.asarray(flat[0], jnp.float32)
        for group in groups:
            numbers = numbers.at[group.columns].set(group(point))
        parts = zip(shapes.items(), jnp.split(numbers, ends), strict=True)
        return _fields({name: x.reshape(shape) for (name, shape), x in parts}, first, varies)

    def model(params: Array) -> dict[str, Array]:
        return at(2.0 * (params[which] - low[which]) / (high - low)[which] - 1.0)

    patched = jax.jit(jax.vmap(at))(points[:_HELD_OUT])
    return Patches(model, _errors(exact, {name: np.asarray(x, np.float64) for name, x in patched.items()}))


def _compiled(env: Env, params: np.ndarray) -> dict[str, np.ndarray]:
    """The numbers of compiled models at params [n, n_params], in double precision; [n, ...] each."""
    ends = make_range(env, env.training)
    effects = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(params), *x.shape)), ends)
    model = env.make_worlds(Theta(jnp.asarray(params), effects)).model
    return {k: np.asarray(x, np.float64) for k, x in model.items() if jnp.issubdtype(x.dtype, jnp.floating)}


def _probes(rng: np.random.Generator, k: int) -> np.ndarray:
    """[bases, 1 + k, k] points: a random one, then the same with one number changed after the other."""
    points = np.tile(rng.uniform(-1.0, 1.0, (_BASES, 1, k)), (1, 1 + k, 1))
    changed = np.arange(k)
    points[:, 1 + changed, changed] = rng.uniform(-1.0, 1.0, (_BASES, k))
    return points.astype(np.float32)


def _depends(flat: np.ndarray) -> np.ndarray:
    """[k, numbers] bool: which parameter changes which number by more than rounding; flat: [bases, 1 + k, numbers]."""
    size = np.abs(flat).max((0, 1))
    return (np.abs(flat[:, 1:] - flat[:, :1]) > 1e-6 * size).any(0)


def _fitted(points: np.ndarray, flat: np.ndarray, depends: np.ndarray) -> Iterator[_Group]:
    """The best fit of every number [worlds, numbers] that depends on any of the parameters."""
    for pattern in np.unique(depends[:, depends.any(0)], axis=1).T:
        columns = np.flatnonzero((depends == pattern[:, None]).all(0))
        inputs = np.flatnonzero(pattern)
        fits = [_fit(points, flat, columns, inputs, name) for name in _TRANSFORMS]
        best = np.argmin([missed for _, missed in fits], axis=0)
        for i in np.unique(best):
            group, kept = fits[i][0], best == i
            yield group._replace(
                columns=columns[kept],
                weights=group.weights[:, kept],
                middle=group.middle[kept],
                scale=group.scale[kept],
            )


def _fit(
    points: np.ndarray, flat: np.ndarray, columns: np.ndarray, inputs: np.ndarray, transform: str
) -> tuple[_Group, np.ndarray]:
    """Least squares for these columns, and by how much each misses held-out worlds; inf where it cannot be taken."""
    degree = max(d for d in range(1, _DEGREE + 1) if d == 1 or math.comb(len(inputs) + d, d) <= _WORLDS // 3)
    there, back = _TRANSFORMS[transform]
    values = flat[:, columns]
    possible = (values > _TINY).all(0) | (transform == "itself")
    aims = there(np, np.where(possible, values, 1.0))
    middle, scale = aims.mean(0), np.maximum(aims.std(0), _TINY)
    seen = _features(points[:, inputs].astype(np.float64), degree)
    learn, test = slice(_HELD_OUT, None), slice(None, _HELD_OUT)
    weights = np.linalg.lstsq(seen[learn], ((aims - middle) / scale)[learn], rcond=None)[0]
    with np.errstate(all="ignore"):
        missed = np.abs(back(np, middle + scale * (seen[test] @ weights)) - values[test]).max(0)
    group = _Group(columns, inputs, degree, transform, weights, middle, scale)
    return group, np.where(possible & np.isfinite(missed), missed, np.inf)


def _features(points: Any, degree: int, numpy: Any = np) -> Any:
    """[..., features] all products of up to `degree` of the numbers [..., k]."""
    k = points.shape[-1]
    powers = numpy.stack([points**d for d in range(degree + 1)], axis=-1)
    # A product of `degree` numbers out of these and of ones: how often each occurs in it.
    products = itertools.combinations_with_replacement(range(k + 1), degree)
    exponents = np.array([np.bincount(product, minlength=k + 1)[:k] for product in products])
    return powers[..., np.arange(k), exponents].prod(axis=-1)


def _errors(exact: dict[str, np.ndarray], patched: dict[str, np.ndarray]) -> dict[str, float]:
    """See `Patches.errors`. Inertias are compared as tensors: principal axes may jump."""
    errors, there = {}, _tensors(patched)
    for name, values in _tensors(exact).items():
        std, size = values.std(0), np.abs(values).max(0)
        missed = np.abs(there[name] - values[:_HELD_OUT]).max(0)
        errors[name] = float((missed / np.maximum(std, _TINY))[std > 1e-6 * size].max(initial=0.0))
    return errors


_AXES = ("body_iquat", "body_inertia")


def _tensors(model: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Inertias [n, bodies, 3] as tensors [n, bodies, 3, 3]: unlike principal axes these do not jump."""
    if not set(_AXES) <= model.keys():
        return model
    quats = np.roll(model["body_iquat"], -1, axis=-1)
    axes = HostRotation.from_quat(quats.reshape(-1, 4)).as_matrix().reshape(*quats.shape[:2], 3, 3)
    tensors = np.einsum("nbij,nbj,nbkj->nbik", axes, model["body_inertia"], axes)
    return {k: x for k, x in model.items() if k != "body_iquat"} | {"body_inertia": tensors}


def _sums(model: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The model with what adds up over the parts of a body: first moments and inertia tensors about its origin."""
    sums = _tensors(model)
    if not {"body_mass", "body_ipos"} <= sums.keys():
        return sums
    mass, place = sums["body_mass"][..., None], sums["body_ipos"]
    moved = {"body_ipos": mass * place}
    if sums.get("body_inertia", mass).ndim == 4:
        moved["body_inertia"] = sums["body_inertia"] + _steiner(mass[..., None], place, np)
    return sums | moved


def _steiner(mass: Any, place: Any, numpy: Any) -> Any:
    """[..., bodies, 3, 3] what inertias about a body's origin have more than those about its centre, `place`."""
    square = numpy.expand_dims((place**2).sum(-1), (-2, -1)) * numpy.broadcast_to(numpy.eye(3), (*place.shape, 3))
    return mass * (square - place[..., :, None] * place[..., None, :])


def _fields(sums: dict[str, Array], first: dict[str, Array], varies: dict[str, np.ndarray]) -> dict[str, Array]:
    """The reverse of `_sums` for one model; bodies that do not vary keep the numbers of the first world."""
    fields, tensors = dict(sums), sums.get("body_inertia", jnp.zeros(0))
    if {"body_mass", "body_ipos"} <= sums.keys():
        mass = sums["body_mass"][..., None]
        centres = sums["body_ipos"] / jnp.maximum(mass, _TINY)
        fields["body_ipos"] = place = jnp.where(varies["body_ipos"], centres, first["body_ipos"])
        if tensors.ndim == 3:
            tensors = tensors - _steiner(mass[..., None], place, jnp)
    if tensors.ndim == 3:
        inertia, quat = jax.vmap(_axes_of)(tensors)
        for name, values in (("body_inertia", inertia), ("body_iquat", quat)):
            fields[name] = jnp.where(varies["body_inertia"][..., 0], values, first[name])
    return fields


def _axes_of(tensor: Array) -> tuple[Array, Array]:
    """The principal inertias [3] of a tensor [3, 3], and the quaternion [4] of their axes."""
    size = jnp.abs(tensor).max() + 1e-12
    inertia, axes = jnp.linalg.eigh(tensor / size)
    axes = axes.at[:, 0].multiply(jnp.sign(jnp.linalg.det(axes)))
    return size * inertia, jnp.roll(Rotation.from_matrix(axes).as_quat(), 1)
