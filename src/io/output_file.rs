//! A file that appears when it is complete: a run that fails leaves what was there before.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use tempfile::NamedTempFile;
use thiserror::Error;

/// Why a file could not be written.
#[derive(Debug, Error)]
#[error("{}: {source}", path.display())]
pub struct OutputError {
    /// The file.
    pub path: PathBuf,
    /// What the system said.
    pub source: io::Error,
}

/// A file being written.
pub struct OutputFile {
    path: PathBuf,
    target: Target,
}

enum Target {
    /// Beside the path, moved there at the end.
    Aside(BufWriter<NamedTempFile>),
    /// What is there is no file (a pipe, /dev/stdout): it is written as it is.
    InPlace(BufWriter<File>),
}

impl OutputFile {
    /// Opens it for writing.
    ///
    /// # Errors
    /// If the folder does not exist or cannot be written to.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let target = match fs::symlink_metadata(path) {
            Ok(found) if !found.is_file() => File::create(path).map(|file| Target::InPlace(BufWriter::new(file))),
            _ => create_aside(path).map(|file| Target::Aside(BufWriter::new(file))),
        };
        let fail = |source| OutputError { path: path.to_owned(), source };
        Ok(Self { path: path.to_owned(), target: target.map_err(fail)? })
    }

    /// Where it will be.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Completes it.
    ///
    /// # Errors
    /// If the last bytes cannot be written, or the file not be moved into place.
    pub fn finish(self) -> Result<(), OutputError> {
        let path = self.path;
        let outcome = match self.target {
            Target::InPlace(mut writer) => writer.flush(),
            Target::Aside(writer) => writer
                .into_inner()
                .map_err(io::IntoInnerError::into_error)
                .and_then(|file| file.persist(&path).map(|_| ()).map_err(|error| error.error)),
        };
        outcome.map_err(|source| OutputError { path, source })
    }

    /// The error of a write to it, with its name.
    pub fn fail(&self, source: io::Error) -> OutputError {
        OutputError { path: self.path.clone(), source }
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.target {
            Target::Aside(writer) => writer.write(bytes),
            Target::InPlace(writer) => writer.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.target {
            Target::Aside(writer) => writer.flush(),
            Target::InPlace(writer) => writer.flush(),
        }
    }
}

fn create_aside(path: &Path) -> io::Result<NamedTempFile> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".bom-").suffix(".part");
    // As any new file, less what the umask takes away; a temporary file is its owner's alone.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_appears_when_it_is_complete() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.json");
        fs::write(&path, "before").unwrap();
        let mut unfinished = OutputFile::create(&path).unwrap();
        unfinished.write_all(b"half").unwrap();
        drop(unfinished);
        assert_eq!(fs::read_to_string(&path).unwrap(), "before");
        let mut file = OutputFile::create(&path).unwrap();
        file.write_all(b"after").unwrap();
        file.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "after");
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "nothing is left aside");
    }

    #[test]
    fn a_missing_folder_is_named_at_once() {
        let Err(error) = OutputFile::create(Path::new("/nowhere/out.json")) else { panic!("created") };
        assert!(error.to_string().starts_with("/nowhere/out.json: "), "{error}");
    }
}
