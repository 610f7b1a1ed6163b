"""Phase of a Lissajous scan measured in its picture: forward against backward half-periods, and self-crossings."""
