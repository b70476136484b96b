"""Whether the calibrated model holds on data that it has not seen."""
