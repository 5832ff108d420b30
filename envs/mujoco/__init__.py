"""MuJoCo scenes as environments: effects, worlds, engines, rendering."""
