"""SEditor's racing tasks: drive a lap of a random track, without touching obstacles or leaving it."""
