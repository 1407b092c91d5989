"""Files in and out: recordings, calibrations, sites, clouds, results."""
