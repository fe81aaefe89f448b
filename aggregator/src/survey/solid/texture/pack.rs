//! Puts rectangles into a picture: the highest first, in rows from left to right.
//!
//! What it knows nothing about: what is in the rectangles.

/// Sides of pictures are multiples of this, px: the blocks of JPEG.
const STEP_PX: u64 = 8;
/// The first width to be tried is that of a square with this many times the area of the rectangles.
const SPARE: f64 = 1.05;

/// Where rectangles lie.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Packed {
    /// Left and upper edge of each, px.
    pub(super) at: Vec<[u32; 2]>,
    /// Width and height of the picture, px.
    pub(super) size_px: [u32; 2],
}

/// Packs rectangles of these widths and heights, px; `None` if they do not fit into a picture with such sides.
pub(super) fn pack(sizes: &[[u32; 2]], side_max_px: u32) -> Option<Packed> {
    let area: f64 = sizes.iter().map(|[width, height]| f64::from(*width) * f64::from(*height)).sum();
    let widest = u64::from(sizes.iter().map(|[width, _]| *width).max()?);
    let width = ((SPARE * area).sqrt() as u64).max(widest).next_multiple_of(STEP_PX);
    let side_max = u64::from(side_max_px);
    [width, side_max].into_iter().filter(|width| *width <= side_max && widest <= *width).find_map(|width| {
        let (at, height) = in_rows(sizes, width);
        let height = height.next_multiple_of(STEP_PX);
        (height <= side_max).then(|| Packed {
            at: at.into_iter().map(|at| at.map(|px| px as u32)).collect(),
            size_px: [width as u32, height as u32],
        })
    })
}

/// Where the rectangles lie in a picture of this width, and its height, px.
fn in_rows(sizes: &[[u32; 2]], width: u64) -> (Vec<[u64; 2]>, u64) {
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|i| std::cmp::Reverse([sizes[*i][1], sizes[*i][0]]));
    let mut at = vec![[0; 2]; sizes.len()];
    let ([mut x, mut y], mut height) = ([0, 0], 0);
    for i in order {
        let [across, down] = sizes[i].map(u64::from);
        if x + across > width {
            (x, y) = (0, y + height);
            height = 0;
        }
        at[i] = [x, y];
        (x, height) = (x + across, height.max(down));
    }
    (at, y + height)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn rectangles_lie_apart_within_the_picture() {
        let sizes: Vec<[u32; 2]> = (0..60).map(|i| [3 + i * 7 % 23, 4 + i * 11 % 17]).collect();
        let Packed { at, size_px } = pack(&sizes, 200).unwrap();
        let [width, height] = size_px.map(|px| px as usize);
        let mut is_taken = vec![false; width * height];
        for ([x, y], [across, down]) in at.iter().zip(&sizes) {
            for row in *y..y + down {
                for column in *x..x + across {
                    assert!((column as usize) < width && (row as usize) < height);
                    let texel = &mut is_taken[row as usize * width + column as usize];
                    assert!(!std::mem::replace(texel, true), "two rectangles at {column}, {row}");
                }
            }
        }
        let taken = is_taken.iter().filter(|is_taken| **is_taken).count();
        assert!(taken * 10 > is_taken.len() * 7, "{taken} of {}", is_taken.len());
        assert_eq!(pack(&sizes, 80), None);
        assert_eq!(pack(&[[201, 3]], 200), None);
    }
}
