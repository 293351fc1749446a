"""The parts of the bench ``articulated``: what one camera tells of bodies with joints, people among them."""
