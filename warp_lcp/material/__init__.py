"""What liquid and sand share: solids and walls as they meet them, gravity, where material comes in and leaves, and how it is evened out."""
