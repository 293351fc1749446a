"""gonio: a self-hosted gait laboratory."""
