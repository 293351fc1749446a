"""Pure functions on arrays: geometry, solvers, biomechanics. No files, clock, log, globals or settings."""
