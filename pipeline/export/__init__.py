"""Export of calibrations to formats of cars, simulators and viewers; import; comparison."""
