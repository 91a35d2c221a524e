"""The second generator, by an author who saw neither the library nor the first one; it uses NumPy alone.

That the two share no formula code is the point of having two: a misreading of the specification shared by the library
and the first generator would pass there and fail here. `interface` alone knows what the bench calls.
"""
