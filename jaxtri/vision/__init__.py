"""Images through OpenCV: frames, feature tracks, hypotheses of relative poses. It decides nothing."""
