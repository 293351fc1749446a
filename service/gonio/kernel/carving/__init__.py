"""Space carving: from silhouettes and cameras to a coloured solid, and how well it covers the silhouettes again."""
