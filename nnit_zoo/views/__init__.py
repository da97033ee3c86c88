"""Other forms of the same weights: pure functions of a PolicyBatch, each with its exact inverse beside it."""
