"""The parts of the bench ``reconstruction``: from keypoints in the images to points and motion."""
