"""Its being here lets tests in the folders below import `probes`, `tuners` and `keys` when they run alone."""
