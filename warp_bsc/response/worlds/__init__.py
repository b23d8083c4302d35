"""Results of a step by world, and worlds that take no part in one."""
