"""The parts of a Markov decision process: each a noun, in torch, for N environments at once."""
