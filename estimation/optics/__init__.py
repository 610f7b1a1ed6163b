"""Effects between beam, sample and detector, found from the intensity samples and corrected.

No estimator of motion and nothing that makes pictures for users may be in here.
"""
