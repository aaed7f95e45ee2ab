//! The recordings folder: names of files, and the cap on what they take together.
//!
//! Files being written are never removed; the closed ones share what the cap leaves, the oldest going first.

use super::RecordingError;
use std::{
    collections::BTreeSet,
    fs::{self, File, OpenOptions},
    io,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{SystemTime, UNIX_EPOCH},
};

/// Part of the cap that files being written may take together, one in this many. As much again stays free for their footers.
const ACTIVE_SHARE: u64 = 8;

/// A folder of `.rrd` files under a cap.
#[derive(Debug)]
pub(super) struct Folder {
    pub dir: PathBuf,
    cap_bytes: u64,
    active: Mutex<BTreeSet<PathBuf>>,
}

impl Folder {
    /// Opens `dir`, making it when missing, proves that it can be written to, and prunes it.
    pub fn open(dir: PathBuf, cap_bytes: u64) -> Result<Folder, RecordingError> {
        let probe = dir.join(format!(".kesi-probe-{}", std::process::id()));
        fs::create_dir_all(&dir)
            .and_then(|()| File::create(&probe))
            .and_then(|_| fs::remove_file(&probe))
            .map_err(|source| RecordingError::Folder { path: dir.clone(), source })?;
        let folder = Folder { dir, cap_bytes, active: Mutex::default() };
        folder.prune()?;
        Ok(folder)
    }

    /// Makes the next file of a session, `{session}-{UTC}.rrd`, after making room for it.
    pub fn create(&self, session: &str) -> Result<(PathBuf, File), RecordingError> {
        self.prune()?;
        let safe: String =
            session.chars().map(|c| if c.is_ascii_alphanumeric() || c == '_' { c } else { '-' }).collect();
        let stem = format!("{safe}-{}", utc_stamp(SystemTime::now()));
        let mut path = self.dir.join(format!("{stem}.rrd"));
        for again in 2.. {
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => {
                    self.active().insert(path.clone());
                    return Ok((path, file));
                }
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists && again < 1000 => {
                    path = self.dir.join(format!("{stem}-{again}.rrd"));
                }
                Err(source) => return Err(RecordingError::File { path, source }),
            }
        }
        unreachable!("the loop returns")
    }

    /// Says that a file is complete: from now on it may be pruned.
    pub fn release(&self, path: &Path) {
        self.active().remove(path);
    }

    /// Size at which a file being written is closed and the next one begun [bytes].
    pub fn segment_bytes(&self) -> u64 {
        self.cap_bytes / ACTIVE_SHARE / self.active().len().max(1) as u64
    }

    /// Removes the oldest closed files until the closed ones leave room for those being written.
    pub fn prune(&self) -> Result<(), RecordingError> {
        let failed = |source| RecordingError::Folder { path: self.dir.clone(), source };
        let mut closed = Vec::new();
        for entry in fs::read_dir(&self.dir).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.extension().is_some_and(|e| e == "rrd") && !self.active().contains(&path) {
                // Another process may remove it between listing and looking.
                if let Ok(meta) = fs::metadata(&path) {
                    closed.push((meta.modified().unwrap_or(UNIX_EPOCH), path, meta.len()));
                }
            }
        }
        closed.sort();
        let mut total: u64 = closed.iter().map(|(_, _, bytes)| bytes).sum();
        for (_, path, bytes) in closed {
            if total <= self.cap_bytes - 2 * self.cap_bytes / ACTIVE_SHARE {
                break;
            }
            match fs::remove_file(&path) {
                Ok(()) => total -= bytes,
                Err(e) if e.kind() == io::ErrorKind::NotFound => total -= bytes,
                Err(source) => return Err(RecordingError::File { path, source }),
            }
        }
        Ok(())
    }

    fn active(&self) -> MutexGuard<'_, BTreeSet<PathBuf>> {
        self.active.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Time as `20261121T004631Z`. Civil date from days by the era method [Hinnant 2013].
fn utc_stamp(time: SystemTime) -> String {
    let seconds = time.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let march_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * march_month + 2) / 5 + 1;
    let month = if march_month < 10 { march_month + 3 } else { march_month - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year:04}{month:02}{day:02}T{:02}{:02}{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn utc_stamps_are_civil_dates() {
        let at = |s| utc_stamp(UNIX_EPOCH + Duration::from_secs(s));
        assert_eq!(at(0), "19700101T000000Z");
        assert_eq!(at(951_782_400), "20000229T000000Z");
        assert_eq!(at(1_795_221_991), "20261121T004631Z");
    }
}
