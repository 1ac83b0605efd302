-- Version 20: campaigns can have measures of their designs.

-- The measures of the saved losses, packed as in the table measures (src/store/measures.c) for all
-- environments of the campaign; NULL: the campaign names none.
ALTER TABLE campaign_losses ADD COLUMN measures BLOB;
