"""The paper's own method, step by step: master curve, shape parameter, polynomial, modulus."""
