"""Other programs and methods that measurements compare with."""
