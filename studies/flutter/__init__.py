"""The study `flutter`."""
