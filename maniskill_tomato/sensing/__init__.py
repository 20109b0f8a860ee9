"""From a camera frame to what a policy knows: fruits, visible fraction, occlusion memory, observation."""
