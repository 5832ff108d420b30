"""MuJoCo scenes as environments: effects, worlds, engines, rendering."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    import mujoco.mjx as _mjx  # noqa: F401
