"""The parts of the bench ``kinetics``: from foot pressure and movement to the knee's torque."""
