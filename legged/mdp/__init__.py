"""The parts of a Markov decision process, each for N environments at once, in torch."""
