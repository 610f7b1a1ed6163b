"""Steps of a reconstruction, each a function of the result of the one before; ``recon.pipeline`` runs them."""
