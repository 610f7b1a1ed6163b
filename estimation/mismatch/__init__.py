"""What the nominal device leaves out: located, named, modelled, and the improvement shown."""
