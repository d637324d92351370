"""What the filters filter: a state, its motion and its measurement, a model a file. No images, no files, no driver."""
