"""Files as they come in and go out: arrays, CSV, HDF5, JSON, folders."""
