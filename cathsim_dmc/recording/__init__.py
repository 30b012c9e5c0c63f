"""Recording of episodes, and their files: npz, Rerun, Minari, image datasets."""
