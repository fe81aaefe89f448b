//! Finds photographs by the names that lists give them. Lists are written on other computers: without folders, with other
//! separators, in other letters.

use std::collections::HashMap;

/// The photographs of a folder, by their names.
pub(super) struct Names {
    /// By the whole path.
    whole: HashMap<String, usize>,
    /// By the name of the file; `None` if several have it.
    last: HashMap<String, Option<usize>>,
}

/// Which photograph is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meant {
    /// The one with this index.
    One(usize),
    /// One of several in different folders.
    Several,
    /// None of these.
    None,
}

impl Meant {
    /// The index, if it is one.
    pub(super) fn one(self) -> Option<usize> {
        if let Self::One(index) = self { Some(index) } else { None }
    }
}

impl Names {
    /// Of photographs with these paths below their folder.
    pub(super) fn of<'a>(paths: impl Iterator<Item = &'a str>) -> Self {
        let mut names = Self { whole: HashMap::new(), last: HashMap::new() };
        for (index, path) in paths.enumerate() {
            let whole = simple(path);
            let last = names.last.entry(last_of(&whole).to_owned());
            last.and_modify(|index| *index = None).or_insert(Some(index));
            names.whole.insert(whole, index);
        }
        names
    }

    /// The photograph that a list means by `name`. A name with a folder may begin farther up than the paths do.
    pub(super) fn find(&self, name: &str) -> Meant {
        let name = simple(name);
        let mut rest = name.as_str();
        loop {
            match (self.whole.get(rest), rest.split_once('/')) {
                (Some(index), _) => return Meant::One(*index),
                (None, Some((_, below))) => rest = below,
                (None, None) => break,
            }
        }
        match self.last.get(last_of(&name)) {
            Some(Some(index)) => Meant::One(*index),
            Some(None) => Meant::Several,
            None => Meant::None,
        }
    }
}

fn simple(path: &str) -> String {
    path.replace('\\', "/").to_lowercase()
}

fn last_of(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_found_with_and_without_folders_unless_several_are_meant() {
        let names = Names::of(["a/DJI_0001.JPG", "b/DJI_0001.JPG", "b/DJI_0002.JPG", "c.jpg"].into_iter());
        for (name, meant) in [
            ("A\\dji_0001.jpg", Meant::One(0)),
            ("/home/user/flight/b/DJI_0001.JPG", Meant::One(1)),
            ("dji_0002.jpg", Meant::One(2)),
            ("elsewhere/C.JPG", Meant::One(3)),
            ("DJI_0001.JPG", Meant::Several),
            ("x/DJI_0001.JPG", Meant::Several),
            ("d.jpg", Meant::None),
        ] {
            assert_eq!(names.find(name), meant, "{name}");
        }
    }
}
