"""A walk cut into cycles: progression, events, phases, averages, spatio-temporal parameters, norms."""
