"""Virtual tours: read those of Marzipano, Pannellum, krpano and Matterport, place their rooms, and write tours."""
