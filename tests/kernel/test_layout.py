"""Arrays in packed buffers: compiled code sees the ones that Python sees."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numba
import numpy as np
import pytest

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.compiled.arrays import robot_view, scene_view
from apex_ompl.kernel.compiled.jit import uncached
from apex_ompl.kernel.compiled.layout import new_buffers, unpack
from apex_ompl.kernel.compiled.path.path_cost import Buffers, buffers_view
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle


def copying(view: Any, names: Iterable[str], arguments: str) -> Any:
    """Return a compiled function that copies each array of a view, and notes its shape and strides.

    Its arguments are the arrays to copy to, memory for shapes and strides, shape (N, 2, 4), buffers and sizes.
    """
    body = "".join(
        f"    a = found.{name}\n"
        f"    for i in range(a.ndim): seen[{k}, 0, i], seen[{k}, 1, i] = a.shape[i], a.strides[i]\n"
        f"    for i in np.ndindex(a.shape): out[{k}][i] = a[i]\n"
        for k, name in enumerate(names)
    )
    made: dict[str, Any] = {"view": view, "np": np}
    exec(f"def copy(out, seen, buffers, sizes):\n    found = view({arguments})\n{body}", made)
    return uncached(made["copy"])


def laid_out(seen: Any, array: Any) -> bool:
    """Whether the shape and the strides that were noted are those of an array."""
    n = array.ndim
    return bool(tuple(seen[0, :n]) == array.shape and (array.size == 0 or tuple(seen[1, :n]) == array.strides))


def test_arrays_come_out_of_a_pack_as_they_went_in(robot: Robot, post: Obstacle) -> None:
    kernel = CollisionChecker(robot, [post]).kernel
    for tables, view in ((kernel.robot, robot_view), (kernel.scene, scene_view)):
        arrays = tables.arrays._asdict()
        out, seen = {name: np.zeros_like(a) for name, a in arrays.items()}, np.zeros((len(arrays), 2, 4), np.int64)
        buffers = ", ".join(f"buffers[{k}]" for k in range(len(tables.packed)))
        copying(view, arrays, buffers)(tuple(out.values()), seen, tables.packed, ())
        sliced = unpack(tables.arrays.__class__, *tables.packed)
        for k, (name, array) in enumerate(arrays.items()):
            assert np.array_equal(getattr(sliced, name), array), name
            assert np.array_equal(out[name], array) and laid_out(seen[k], array), name


def test_compiled_code_sees_the_arrays_of_buffers_that_python_sees() -> None:
    sizes = {"unknowns": 6, "points": 4, "dof": 3}
    integers, floats, arrays = new_buffers(Buffers, **sizes)
    integers[:], floats[:] = np.arange(len(integers)), np.arange(len(floats))
    out, seen = tuple(np.zeros_like(a) for a in arrays), np.zeros((len(arrays), 2, 4), np.int64)
    copy = copying(buffers_view, arrays._fields, "buffers[0], buffers[1], sizes")
    copy(out, seen, (integers, floats), tuple(sizes.values()))
    for k, (name, array) in enumerate(arrays._asdict().items()):
        assert array.size and np.array_equal(out[k], array) and laid_out(seen[k], array), name
    with pytest.raises(numba.TypingError, match="buffers of Buffers are"):
        copy(out, seen, (integers, floats[::2]), tuple(sizes.values()))
