"""EgoVM: poses from cameras, LiDAR and a vector map, as ``sensors.PoseFix``; how it is trained and judged."""
