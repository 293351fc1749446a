"""Linear algebra and minimisation that several stations share."""
