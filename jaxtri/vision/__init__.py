"""Images through OpenCV: frames, feature tracks, hypotheses of relative poses. Nothing here decides what a filter does."""
