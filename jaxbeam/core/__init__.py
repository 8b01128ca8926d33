"""What is asked of JAX and of the user: pytrees, compilation, derivative rules, checks of arguments."""
