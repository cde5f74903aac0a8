"""Programs of all experiments at once: as one batch, or spread over devices.

Each device has a share of the experiments, of equal number: the last is repeated where they do not divide, and what is
repeated is left out of what is returned. Devices run by themselves (`jax.shard_map`): a batch takes as many steps as
its longest run, and none waits for those of others. What they return, residuals and Jacobians, is gathered on every
device, so that the steps of a fit, a small matter beside them, are taken everywhere alike.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from ..base.aliases import PyTree
from ..base.errors import ModelError

Found = TypeVar("Found", bound=PyTree)
# A function of numbers that experiments share, those of one experiment, and its conditions.
Function = Callable[[Array, Array, PyTree], Found]


def each(function: Function[Found], mesh: Mesh | None, shared: Array, own: Array, conditions: PyTree) -> Found:
    """`function(shared, own, conditions)` of each experiment, on the devices of a mesh if there is one."""
    if mesh is None:
        return _batch(function, shared, own, conditions)
    count = own.shape[0]
    missing = -count % mesh.size
    own, conditions = jax.tree.map(lambda a: jnp.concatenate([a, *[a[-1:]] * missing]), (own, conditions))
    split, whole = PartitionSpec(mesh.axis_names), PartitionSpec()

    def share(shared, own, conditions):
        found = _batch(function, shared, own, conditions)
        return jax.tree.map(lambda a: jax.lax.all_gather(a, mesh.axis_names, tiled=True), found)

    spread = jax.shard_map(share, mesh=mesh, in_specs=(whole, split, split), out_specs=whole, check_vma=False)
    return jax.tree.map(lambda a: a[:count], spread(shared, own, conditions))


def each_with_slopes(
    function: Function[Found], mesh: Mesh | None, shared: Array, own: Array, conditions: PyTree
) -> tuple[Found, Found, Found]:
    """As `each`, with derivatives, found forwards: (values, derivatives by the shared numbers, by each experiment's
    own)."""

    def twice(shared, own, conditions):
        found = function(shared, own, conditions)
        return found, found

    def with_slopes(shared, own, conditions):
        slopes, found = jax.jacfwd(twice, argnums=(0, 1), has_aux=True)(shared, own, conditions)
        return found, *jax.tree.transpose(jax.tree.structure(found), None, slopes)

    return each(with_slopes, mesh, shared, own, conditions)


def _batch(function: Function[Found], shared: Array, own: Array, conditions: PyTree) -> Found:
    """A single experiment is not made a batch, which costs compile time."""
    if own.shape[0] == 1:
        found = function(shared, own[0], jax.tree.map(lambda a: a[0], conditions))
        return jax.tree.map(lambda a: a[None], found)
    return jax.vmap(function, in_axes=(None, 0, 0))(shared, own, conditions)


def check_mesh(mesh: object) -> Mesh | None:
    """The mesh given, or a `ModelError`."""
    if mesh is None:
        return None
    if isinstance(mesh, Mesh):
        return Mesh(mesh.devices, mesh.axis_names)  # whose axes JAX may use as it needs to, whatever was declared
    raise ModelError(
        "mesh is a mesh of devices, jax.make_mesh((jax.device_count(),), ('experiments',)), or None; got "
        f"{type(mesh).__name__}"
    )
