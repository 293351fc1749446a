"""What the ground does to the feet: measured by plates, or found from foot pressure and movement."""
