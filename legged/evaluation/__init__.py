"""How well a policy does: tracking errors, success on terrain, crossings."""
