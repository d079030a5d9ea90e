"""EgoVM: poses from cameras, LiDAR and a vector map. Nothing is here yet; its results travel as ``sensors.PoseFix``."""
