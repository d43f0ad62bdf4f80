"""The web page: model against measurement, the missing effect, the falling error; of every mission."""
