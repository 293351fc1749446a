"""The body model as a tree of elementary joints: forward kinematics and scaling."""
