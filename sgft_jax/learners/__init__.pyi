from . import cql, darc, edac, h2o, h2oplus, iql, rebrac, recurrent, sac, tdmpc2

__all__ = ["cql", "darc", "edac", "h2o", "h2oplus", "iql", "rebrac", "recurrent", "sac", "tdmpc2"]
