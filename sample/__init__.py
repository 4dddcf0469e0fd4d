"""Sample scenes, each a folder with scene.json and scene.npz."""
