"""Its being here lets tests in the folders below import `probes` and `tuners` when they run alone."""
