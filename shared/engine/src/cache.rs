//! Keeps renderings in memory until they are needed again, within a limit on their bytes.

use std::collections::BTreeMap;
use std::rc::Rc;

use crate::backend::Rendering;

/// Renderings by key. A rendering that would exceed the limit is not kept; a kept rendering is never dropped.
#[derive(Debug)]
pub struct RenderingCache<K> {
    kept: BTreeMap<K, Rc<Rendering>>,
    /// Bytes that further renderings may take.
    free_bytes: u64,
}

impl<K: Ord> RenderingCache<K> {
    /// An empty cache whose renderings may take `bytes` bytes in total.
    pub fn new(bytes: u64) -> Self {
        Self { kept: BTreeMap::new(), free_bytes: bytes }
    }

    /// The rendering that is kept for a key, if any.
    pub fn get(&self, key: &K) -> Option<Rc<Rendering>> {
        self.kept.get(key).cloned()
    }

    /// Puts a rendering into an [`Rc`], and keeps it if it fits within the limit. The cache must not hold a rendering
    /// for the key yet.
    pub fn keep(&mut self, key: K, rendering: Rendering) -> Rc<Rendering> {
        let bytes = rendering.bytes() as u64;
        let rendering = Rc::new(rendering);
        if bytes <= self.free_bytes {
            self.free_bytes -= bytes;
            self.kept.insert(key, rendering.clone());
        }
        rendering
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rendering(pixels: usize) -> Rendering {
        let values = |count: usize| vec![0.5; count];
        Rendering {
            size_px: [pixels as u32, 1],
            rgb: values(3 * pixels),
            alpha: values(pixels),
            depth: values(pixels),
            normal: values(3 * pixels),
        }
    }

    #[test]
    fn renderings_are_kept_until_the_bytes_are_used_up() {
        let bytes = rendering(10).bytes() as u64;
        let mut cache = RenderingCache::new(2 * bytes);
        assert_eq!(*cache.keep('a', rendering(10)), rendering(10));
        cache.keep('b', rendering(11));
        cache.keep('c', rendering(10));
        cache.keep('d', rendering(0));
        assert_eq!(['a', 'b', 'c', 'd'].map(|key| cache.get(&key).is_some()), [true, false, true, false]);
    }
}
